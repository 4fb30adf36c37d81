"""A run: its search loop, its results folder, its display and its pictures.

- ``generation``: one generation as pure functions; ``search``: the step from one
  generation to the next; ``evolution``: the loop;
  ``evolve_result``: what it returns
- ``archive``, ``checkpoint``, ``folder``: the files of a run
- ``opened``: a results folder, opened again
- ``interrupt``, ``progress``, ``plot``, ``tensorboard``: signals, display and pictures
"""
