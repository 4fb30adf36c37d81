"""A run: its search loop, its results folder, and what it shows and draws.

- ``search``: one generation after the other, as a pure step; ``evolution``: the loop
- ``archive``, ``checkpoint``, ``folder``: what a run writes and reads
- ``interrupt``, ``progress``, ``plot``, ``tensorboard``: signals, and what a user sees
"""
