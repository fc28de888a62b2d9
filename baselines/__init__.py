"""Controllers for perturbed flat systems, the exact solution of their closed loops, and what measures them."""

from baselines.filippov import filippov
from baselines.registry import make, names
from baselines.rollout import rollout
from baselines.trajectory import Trajectory

__all__ = ["Trajectory", "filippov", "make", "names", "rollout"]
