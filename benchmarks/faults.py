"""Prepared faults, and what `estbench explain` names: `python -m benchmarks.faults`."""

import tempfile
from pathlib import Path

import estbench
from estbench.analysis.evidence import gather
from estbench.analysis.explain import explain
from estbench.analysis.load import load

OUTLIERS = [f"channels.{c}.outlier_probability=0.05" for c in ("cart_encoder", "pole_encoder")]
LATE = ["channels.encoder.latency=0.05"]
RANDOM = ["channels.encoder.latency=0.03", "channels.encoder.latency_std=0.02"]
FAULTS: dict[str, tuple[str, str, list[str]]] = {
    "Q x 0.01": ("Q too small", "cartpole", ["filter.process_noise_scale=0.01"]),
    "Q x 1e4": ("Q too large", "pendulum", ["filter.process_noise_scale=1e4"]),
    "R x 0.1": ("R too small", "cartpole", ["filter.measurement_noise_scale=0.1"]),
    "R x 10": ("R too large", "cartpole", ["filter.measurement_noise_scale=10.0"]),
    "wrong x̂₀": ("start", "cartpole", ["start.offset={pole=0.3}", "start.inflate=0.2"]),
    "bias of a gyro": ("bias", "cartpole_bias", []),
    "late as current": ("latency", "pendulum", [*LATE, "filter.delays=naive"]),
    "outliers": ("outliers", "cartpole", OUTLIERS),
    "window too short": ("window", "pendulum", [*RANDOM, "filter.window=0.03"]),
    "noise for a while": (
        "event", "cartpole",
        [
            "channels.pole_encoder.schedule=[[1.0, 1.0], [1.4, 5.0], [9.0, 1.0]]",
            "filter.channels.pole_encoder.follow_schedule=false",
        ],
    ),
    "contact": ("contact", str(Path(__file__).with_name("drop.toml")), ["bound=false"]),
    "Q x 0.02, chaotic": (
        "Q too small", "acrobot", ["filter.process_noise_scale=0.02", "bound=false"]
    ),
}  # fmt: skip
"""Fault -> the rule that should name it, the scenario, and what is wrong in it."""


def store(fault: str, folder: Path, runs: int = 40, duration: float = 2.0) -> Path:
    """The results of an EKF on a scenario with this fault."""
    _, scenario, overrides = FAULTS[fault]
    estbench.run(scenario, ["ekf"], runs=runs, duration=duration, overrides=overrides, out=folder)
    return folder


def named(folder: Path) -> list[str]:
    """The rules that speak, the most specific first."""
    return [finding.rule for finding in explain(gather(load(folder), "ekf"))]


if __name__ == "__main__":
    right = 0
    with tempfile.TemporaryDirectory() as folder:
        for i, (fault, (expected, *_)) in enumerate(FAULTS.items()):
            found = named(store(fault, Path(folder) / str(i)))
            right += found[:1] == [expected]
            print(f"{fault:20} expected {expected:12} found {', '.join(found) or 'nothing'}")
    print(f"{right} of {len(FAULTS)} faults are named first")
