"""Gymnasium environments whose policy sees the estimate.

Importing this registers `estbench/Pendulum-v0`, `CartPole-v0`, `Acrobot-v0`, `Quadrotor-v0` and
`estbench/Scenario-v0`. Without an import, and in the workers of another library, the id is
`estbench.envs:estbench/CartPole-v0`: gymnasium imports what stands before the colon.
"""

from gymnasium.envs.registration import register, registry

from estbench.envs.errors import EnvError
from estbench.envs.truth_info import RecordTruth
from estbench.envs.vector_wrapper import VectorEstimatedObservation
from estbench.envs.wrapper import EstimatedObservation

__all__ = ["EnvError", "EstimatedObservation", "RecordTruth", "VectorEstimatedObservation"]

for _name, _scenario in {
    "Pendulum": "pendulum",
    "CartPole": "cartpole",
    "Acrobot": "acrobot",
    "Quadrotor": "quadrotor",
    "Scenario": None,
}.items():
    if f"estbench/{_name}-v0" not in registry:
        register(
            f"estbench/{_name}-v0",
            entry_point="estbench.envs.native:ScenarioEnv",
            vector_entry_point="estbench.envs.vector:ScenarioVectorEnv",
            kwargs={} if _scenario is None else {"scenario": _scenario},
        )
