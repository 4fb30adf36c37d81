"""Kernels of a CPU that XLA calls without Python."""

from newton_qd.physics.native.plans import Plan, Rollouts, all_plans

__all__ = ["Plan", "Rollouts", "all_plans"]
