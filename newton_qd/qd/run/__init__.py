"""A run: its search loop, its results folder, and what it shows and draws.

- ``generation``: one generation as pure functions; ``search``: one after the other;
  ``evolution``: the loop
- ``archive``, ``checkpoint``, ``folder``: what a run writes and reads
- ``interrupt``, ``progress``, ``plot``, ``tensorboard``: signals, and what a user sees
"""
