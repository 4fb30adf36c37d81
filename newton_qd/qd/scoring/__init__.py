"""Evaluation of individuals: tasks, policies and scoring functions.

- ``task``: environment and descriptor; ``rollout``: policies and their evaluation
- ``gradient_scoring``: evaluation with gradients; ``gradient_scores``: the scores that
  emitters read
- ``sharding``: evaluation on several devices; ``ribs``: evaluation for pyribs
"""
