"""``state.qp`` and ``env.sys`` for code that was written for brax v1.

``newton_qd.create(..., brax_views=True)`` and ``newton_qd.compat`` put the wrapper
around an environment.
"""

from newton_qd.brax_views.fixed_initial_state import FixedInitialStateWrapper
from newton_qd.brax_views.views import QP, Info, SystemView
from newton_qd.brax_views.wrapper import BODY_NAMES, BraxState, BraxViewsWrapper

__all__ = [
    "BODY_NAMES",
    "QP",
    "BraxState",
    "BraxViewsWrapper",
    "FixedInitialStateWrapper",
    "Info",
    "SystemView",
]
