"""Random MJCFs: trees of bodies with joints, actuators and sensors, some of them broken."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import estbench
from benchmarks.fuzz.case import Case

JOINTS = ("hinge", "slide", "ball", "free")
SENSORS = ("jointpos", "jointvel", "framepos", "gyro", "accelerometer", "ballquat", "touch",
           "subtreecom", "velocimeter")  # fmt: skip
NUMBERS = ("0", "-1", "nan", "1e20", "1e-20", "inf", "x", "", "1e-300", "1e300")
NAMES = ("", "a b", "ü", "=1+1", "*", "a.b", "truth", "a/b", "&#10;x", "-x", "x" * 300)


def cases(count: int, seed: int) -> Iterator[Case]:
    """MJCFs; two thirds have something odd in them."""
    for i in range(count):
        rng = np.random.default_rng((seed, 2, i))
        text, odd = _mjcf(rng)
        wild = any(part in NUMBERS for part in odd)
        yield Case(f"MJCF {i}: {', '.join(odd) or 'plain'}", _Run(text), wild)


def _mjcf(rng: np.random.Generator) -> tuple[str, list[str]]:
    odd: list[str] = []

    def number(usual: float) -> str:
        if rng.random() < 0.02:
            odd.append(str(rng.choice(NUMBERS)))
            return odd[-1]
        return f"{usual:.4g}"

    def name(usual: str) -> str:
        if rng.random() < 0.03:
            odd.append(f"name {str(rng.choice(NAMES))!r}")
            return odd[-1][6:-1]
        return usual

    joints, bodies, parts, depth = [], [], [], 0
    for i in range(int(rng.integers(1, 8))):
        kind = str(rng.choice(JOINTS, p=[0.6, 0.25, 0.1, 0.05]))
        if kind == "free" and depth:
            kind = "hinge"
        body, joint = name(f"b{i}"), name(f"j{i}")
        bodies.append(body)
        joints.append((joint, kind))
        shape = str(rng.choice(["sphere", "box", "capsule"]))
        parts.append(
            f'<body name="{body}" pos="0 0 {number(0.5)}"><joint name="{joint}" type="{kind}" '
            f'damping="{number(0.1)}"/><geom type="{shape}" size="{number(0.1)} {number(0.1)} '
            f'{number(0.1)}" mass="{number(1.0)}"/><site name="s{i}"/>'
        )
        depth += 1
        if rng.random() < 0.4:
            parts.append("</body>")
            depth -= 1
    tree = "".join(parts) + "</body>" * depth
    actuators = "".join(
        f'<motor name="{name(f"m{i}")}" joint="{j}" gear="{number(1.0)}"/>'
        for i, (j, kind) in enumerate(joints)
        if kind in ("hinge", "slide") and rng.random() < 0.6
    )
    sensors = ""
    for i in range(int(rng.integers(0, 6))):
        kind = str(rng.choice(SENSORS))
        k = int(rng.integers(len(joints)))
        place = (
            f'joint="{joints[k][0]}"'
            if kind.startswith(("joint", "ball"))
            else f'objtype="body" objname="{bodies[k]}"'
            if kind.startswith("frame")
            else f'body="{bodies[k]}"'
            if kind == "subtreecom"
            else f'site="s{k}"'
        )
        sensors += f'<{kind} name="{name(f"y{i}")}" {place} noise="{number(0.01)}"/>'
    option = f'<option timestep="{number(0.01)}"/>'
    text = (
        f"<mujoco>{option}<worldbody>{tree}</worldbody><actuator>{actuators}</actuator>"
        f"<sensor>{sensors}</sensor></mujoco>"
    )
    if rng.random() < 0.1:
        cut = int(rng.integers(len(text)))
        odd.append(f"cut at {cut}")
        text = text[:cut]
    return text, odd


class _Run:
    def __init__(self, text: str):
        self._text = text

    def __call__(self, folder: Path) -> str:
        path = folder / "robot.xml"
        path.write_text(self._text, encoding="utf-8")
        results: Any = estbench.run(path, "ekf", runs=2, duration=0.05)
        str(results)
        return ", ".join(f"{s.label}: {s.verdict}" for s in results.summaries)
