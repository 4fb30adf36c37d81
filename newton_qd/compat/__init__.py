"""QDax as released on PyPI, on the environments of this library.

    import newton_qd.compat

    newton_qd.compat.install()

After this, ``qdax.tasks.brax.v1`` and the older ``qdax.environments`` and
``qdax.tasks.brax_envs`` are made of this library's environments, wrappers and
extractors; everything else of QDax is its own code. No file of QDax is changed.
"""

from newton_qd.compat.finder import SUPPORTED, install, uninstall

__all__ = ["SUPPORTED", "install", "uninstall"]
