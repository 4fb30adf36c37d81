"""What an individual is worth: tasks, policies and scoring functions.

- ``task``: environment and descriptor; ``rollout``: policies and their evaluation
- ``gradient_scoring``: evaluation with gradients; ``gradient_scores``: how emitters
  read them
- ``sharding``: evaluation on several devices; ``ribs``: evaluation for pyribs
"""
