"""The modules of QDax that this library replaces, and their contents.

``CONTENTS`` maps the name of a module to ``{home: names}``. ``home`` is the module that
defines these names: a module of this library, or of QDax for names that have moved.
"""

from __future__ import annotations

from collections.abc import Mapping

Contents = Mapping[str, tuple[str, ...]]

_EXTRACTORS = ("get_feet_contact_proportion", "get_final_xy_position")
_AURORA = ("AuroraExtraInfo", "AuroraExtraInfoNormalization")
_LOCOMOTION: Contents = {
    "newton_qd.tables": ("COG_NAMES", "FEET_NAMES", "FORWARD_REWARD_NAMES"),
    "newton_qd.wrappers": (
        "FeetContactWrapper",
        "NoForwardRewardWrapper",
        "XYPositionWrapper",
    ),
}
_BASE: Contents = {
    "newton_qd.envs.base": ("QDEnv",),
    "newton_qd.wrappers": ("QDWrapper", "StateDescriptorResetWrapper"),
}
_EVALUATION: Contents = {
    "newton_qd.wrappers": ("CompletedEvalMetrics", "CompletedEvalWrapper")
}
_REWARD: Contents = {"newton_qd.wrappers": ("ClipRewardWrapper", "OffsetRewardWrapper")}
_EXPLORATION: Contents = {"newton_qd.wrappers": ("MazeWrapper", "TrapWrapper")}
_INITIAL: Contents = {"newton_qd.brax_views": ("FixedInitialStateWrapper",)}
_HUMANOID_TRAP: Contents = {"newton_qd.envs.humanoid_trap": ("HumanoidTrap",)}
_POINT_MAZE: Contents = {"newton_qd.envs.pointmaze": ("PointMaze",)}
_ENVIRONMENTS: Contents = {
    **_HUMANOID_TRAP,
    **_INITIAL,
    **_POINT_MAZE,
    "newton_qd.envs.base": ("Env", "QDEnv"),
    "newton_qd.extractors": _EXTRACTORS,
    "newton_qd.wrappers": (
        "AutoResetWrapper",
        "CompletedEvalWrapper",
        "EpisodeWrapper",
        "EvalWrapper",
        "FeetContactWrapper",
        "MazeWrapper",
        "NoForwardRewardWrapper",
        "StateDescriptorResetWrapper",
        "TrapWrapper",
        "VectorWrapper",
        "XYPositionWrapper",
    ),
}
_SCORING = (
    "create_brax_scoring_fn",
    "create_default_brax_task_components",
    "get_aurora_scoring_fn",
    "get_mask_from_transitions",
    "make_policy_network_play_step_fn_brax",
    "scoring_function_brax_envs",
)

# QDax 0.5.
_NEW: dict[str, Contents] = {
    "qdax.tasks.brax.descriptor_extractors": {
        "newton_qd.extractors": (*_EXTRACTORS, "get_aurora_encoding"),
        "qdax.custom_types": ("AuroraExtraInfoNormalization",),
    },
    "qdax.tasks.brax.v1": {
        **_ENVIRONMENTS,
        "newton_qd.compat.env_creators": ("create", "create_fn"),
        "newton_qd.tables": ("descriptor_extractor", "reward_offset"),
    },
    "qdax.tasks.brax.v1.env_creators": {"newton_qd.compat.env_creators": _SCORING},
    "qdax.tasks.brax.v1.envs": {},
    "qdax.tasks.brax.v1.envs.base_env": {"newton_qd.envs.base": ("QDEnv",)},
    "qdax.tasks.brax.v1.envs.humanoidtrap": _HUMANOID_TRAP,
    "qdax.tasks.brax.v1.envs.pointmaze": _POINT_MAZE,
    "qdax.tasks.brax.v1.wrappers": {},
    "qdax.tasks.brax.v1.wrappers.base_wrappers": _BASE,
    "qdax.tasks.brax.v1.wrappers.eval_metrics_wrapper": _EVALUATION,
    "qdax.tasks.brax.v1.wrappers.exploration_wrappers": _EXPLORATION,
    "qdax.tasks.brax.v1.wrappers.init_state_wrapper": _INITIAL,
    "qdax.tasks.brax.v1.wrappers.locomotion_wrappers": _LOCOMOTION,
    "qdax.tasks.brax.v1.wrappers.reward_wrappers": _REWARD,
}

# QDax 0.2 to 0.4. Today's release does not have these modules.
_OLD: dict[str, Contents] = {
    "qdax.environments": {
        **_ENVIRONMENTS,
        "newton_qd.compat.brax_envs": ("create", "create_fn"),
        "newton_qd.tables": ("behavior_descriptor_extractor", "reward_offset"),
    },
    "qdax.environments.base_wrappers": _BASE,
    "qdax.environments.bd_extractors": {
        "newton_qd.extractors": (*_EXTRACTORS, "get_aurora_encoding"),
        "qdax.custom_types": _AURORA,
    },
    "qdax.environments.exploration_wrappers": _EXPLORATION,
    "qdax.environments.humanoidtrap": _HUMANOID_TRAP,
    "qdax.environments.init_state_wrapper": _INITIAL,
    "qdax.environments.locomotion_wrappers": _LOCOMOTION,
    "qdax.environments.pointmaze": _POINT_MAZE,
    "qdax.environments.wrappers": {
        "newton_qd.wrappers": (
            *_EVALUATION["newton_qd.wrappers"],
            *_REWARD["newton_qd.wrappers"],
        )
    },
    "qdax.tasks.brax_envs": {
        "newton_qd.compat.brax_envs": (
            *_SCORING,
            "create_policy_network_play_step_fn",
            "reset_based_scoring_actor_dc_function_brax_envs",
            "reset_based_scoring_function_brax_envs",
            "scoring_actor_dc_function_brax_envs",
        )
    },
    "qdax.types": {
        "newton_qd.compat.brax_envs": ("JumanjiState",),
        "qdax.custom_types": (
            "Action",
            "Centroid",
            "Descriptor",
            "Done",
            "EnvState",
            "ExtraScores",
            "Fitness",
            "Genotype",
            "Gradient",
            "Mask",
            "Metrics",
            "Observation",
            "Params",
            "ParetoFront",
            "Reward",
            "RNGKey",
            "Skill",
            "Spread",
            "StateDescriptor",
        ),
    },
}

CONTENTS: Mapping[str, Contents] = {**_NEW, **_OLD}

_JUMPY = (
    "abs",
    "all",
    "amax",
    "amin",
    "any",
    "arange",
    "arccos",
    "arcsin",
    "arctan2",
    "arctanh",
    "argmax",
    "argmin",
    "array",
    "atleast_1d",
    "atleast_2d",
    "atleast_3d",
    "ceil",
    "concatenate",
    "cos",
    "cross",
    "diag",
    "dot",
    "exp",
    "eye",
    "float32",
    "floor",
    "inf",
    "int32",
    "logical_and",
    "logical_not",
    "logical_or",
    "matmul",
    "max",
    "maximum",
    "mean",
    "meshgrid",
    "min",
    "minimum",
    "multiply",
    "ndarray",
    "ones",
    "ones_like",
    "outer",
    "pi",
    "prod",
    "repeat",
    "reshape",
    "roll",
    "round",
    "sign",
    "sin",
    "sqrt",
    "square",
    "stack",
    "std",
    "sum",
    "tan",
    "tanh",
    "tile",
    "var",
    "where",
    "zeros",
    "zeros_like",
)

BRAX_V1: Mapping[str, Contents] = {
    "brax.v1": {"newton_qd.compat.brax_v1": ("QP",)},
    "brax.v1.envs": {
        "newton_qd.envs.base": ("Env",),
        "newton_qd.envs.state": ("State",),
        "newton_qd.wrappers.base": ("Wrapper",),
    },
    "brax.v1.io": {},
    "brax.v1.io.html": {"newton_qd.compat.brax_v1": ("render", "save_html")},
    "brax.v1.jumpy": {
        "jax.lax": ("cond", "fori_loop", "scan", "top_k", "while_loop"),
        "jax.numpy": _JUMPY,
        "jax.numpy.linalg": ("inv",),
        "jax.ops": ("segment_sum",),
        "jax.tree_util": ("tree_map",),
        "newton_qd.compat.brax_v1": (
            "choice",
            "clip",
            "expand_dims",
            "index_update",
            "norm",
            "randint",
            "random_prngkey",
            "random_split",
            "random_uniform",
            "safe_arccos",
            "safe_arcsin",
            "safe_norm",
            "take",
            "vmap",
        ),
    },
    "brax.v1.physics": {},
    "brax.v1.physics.base": {"newton_qd.compat.brax_v1": ("QP", "vec_to_arr")},
    "brax.v1.physics.config_pb2": {"newton_qd.compat.brax_v1": ("Joint",)},
}
"""Modules of brax v1 that scripts of QDax import, if it is not installed."""
