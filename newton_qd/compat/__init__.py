"""Runs the released QDax with the environments of this library.

    import newton_qd.compat

    newton_qd.compat.install()

After this, ``qdax.tasks.brax.v1`` and the older ``qdax.environments`` and
``qdax.tasks.brax_envs`` contain the environments, wrappers and extractors of this
library. All other modules of QDax are its own. No file of QDax is changed.
"""

from newton_qd.compat.finder import SUPPORTED, install, installed, uninstall

__all__ = ["SUPPORTED", "install", "installed", "uninstall"]
