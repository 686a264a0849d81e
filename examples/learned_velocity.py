"""A velocity estimator learned from readings and truth, judged beside the EKF.

A small network takes the last readings of the cart-pole's two encoders and the controls, and gives
the state and one covariance. It is trained by the Gaussian likelihood of the true state on runs of
seed 0, written by `estbench export`, and judged on runs of seed 1. Needs torch; the training takes
about a minute on one core:

    python examples/learned_velocity.py
"""

import argparse
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import estbench
from estbench import Innovation
from estbench.logs.export import export

READINGS = ("cart_encoder", "pole_encoder")
STATE = ("x.cart", "x.pole", "x.cart.vel", "x.pole.vel")
WINDOW, PERIOD = 16, 0.01  # readings, s
SCALE = np.array([0.01, 0.01, 0.1, 0.1])  # of the network's outputs: m, rad, m/s, rad/s


@dataclass(frozen=True, eq=False)
class Belief:
    mean: np.ndarray  # x̂ (run, 4)
    cov: np.ndarray  # P (run, 4, 4)
    window: np.ndarray  # the last readings and controls (run, WINDOW, 3)


class LearnedVelocity:
    """The model predicts; at each reading the network's estimate replaces the prediction."""

    def __init__(self, model, weights: str = "learned_velocity.npz"):
        self.model = model
        with np.load(weights) as stored:
            self.layers = [stored[f"a{i}"] for i in range(len(stored.files) - 1)]
            factor = stored["factor"]
        self.learned = factor @ factor.T

    def init(self, mean, cov):
        held = np.concatenate([mean[:, :2], np.zeros((len(mean), 1))], axis=1)
        return Belief(mean, cov, np.repeat(held[:, None], WINDOW, axis=1))

    def predict(self, belief, u, t, dt):
        mean, F = self.model.transition_jacobian(belief.mean, u, t, dt)
        cov = F @ belief.cov @ F.mT + self.model.process_noise(belief.mean, u, t, dt)
        return replace(belief, mean=mean, cov=cov)

    def update(self, belief, y, u, t, channels=None, mask=None):
        y_hat, H = self.model.measurement_jacobian(belief.mean, u, t, channels)
        S = H @ belief.cov @ H.mT + self.model.measurement_noise(t, channels)
        nu = y - y_hat
        white = np.linalg.solve(np.linalg.cholesky(S), nu[..., None])[..., 0]
        window = np.concatenate([belief.window[:, 1:], np.c_[y, u][:, None]], axis=1)
        mean = guess(window) + SCALE * network(self.layers, features(window))
        cov = np.broadcast_to(self.learned, belief.cov.shape)
        dof = np.full(len(y), y.shape[1])
        return Belief(mean, cov, window), Innovation(nu, S, white, (white**2).sum(axis=1), dof)

    def mean(self, belief):
        return belief.mean

    def cov(self, belief):
        return belief.cov


def guess(window):
    """The last readings, and their mean rate over the window (run, 4)."""
    rate = (window[:, -1, :2] - window[:, 0, :2]) / ((WINDOW - 1) * PERIOD)
    return np.concatenate([window[:, -1, :2], rate], axis=1)


def features(window):
    """Positions, their changes within the window in units of R, and controls (run, features)."""
    changes = (window[:, :-1, :2] - window[:, -1:, :2]) / SCALE[:2]
    parts = window[:, -1, :2], changes.reshape(len(window), -1), 0.1 * window[..., 2]
    return np.concatenate(parts, axis=1)


def network(layers, inputs):
    """A perceptron with one hidden layer of tanh; layers are W₁, b₁, W₂, b₂ (run, 4)."""
    W1, b1, W2, b2 = layers
    return np.einsum("rh,oh->ro", np.tanh(np.einsum("ri,hi->rh", inputs, W1) + b1), W2) + b2


def windows(files):
    """Windows of readings and controls, and the true state at the end of each."""
    inputs, states = [], []
    for file in files:
        table = np.genfromtxt(file, delimiter=",", names=True, deletechars="")
        held = np.r_[0.0, table["u.force"][:-1]]  # the control that led to the reading
        rows = np.c_[np.stack([table[name] for name in READINGS], axis=1), held][1:]
        truth = np.stack([table[name] for name in STATE], axis=1)[1:]
        inputs.append(np.lib.stride_tricks.sliding_window_view(rows, WINDOW, axis=0).mT)
        states.append(truth[WINDOW - 1 :])
    return np.concatenate(inputs), np.concatenate(states)


def train(files, epochs: int, seed: int = 0):
    """Fit the network and the factor L of P = L Lᵀ by the likelihood of the true states."""
    import torch  # pyright: ignore[reportMissingImports]
    from torch.utils.data import DataLoader, TensorDataset  # pyright: ignore[reportMissingImports]

    torch.manual_seed(seed)
    window, state = windows(files)
    target = (state - guess(window)) / SCALE
    data = TensorDataset(
        *(torch.tensor(a, dtype=torch.float32) for a in (features(window), target))
    )
    loader = DataLoader(data, batch_size=1024, shuffle=True)
    size = data.tensors[0].shape[1]
    net = torch.nn.Sequential(torch.nn.Linear(size, 64), torch.nn.Tanh(), torch.nn.Linear(64, 4))
    raw = torch.nn.Parameter(torch.eye(4))
    optimizer = torch.optim.Adam([*net.parameters(), raw], lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    loss = torch.tensor(0.0)
    for epoch in range(epochs):
        for x, y in loader:
            factor = raw.tril(-1) + torch.diag(raw.diagonal().abs() + 1e-3)
            belief = torch.distributions.MultivariateNormal(net(x), scale_tril=factor)
            loss = -belief.log_prob(y).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        schedule.step()
        if epoch % 5 == 0 or epoch == epochs - 1:
            print(f"epoch {epoch}: log-likelihood {-loss.item():.3f}", flush=True)
    factor = raw.tril(-1) + torch.diag(raw.diagonal().abs() + 1e-3)
    layers = [p.detach().double().numpy() for p in net.parameters()]
    return layers, SCALE[:, None] * factor.detach().double().numpy()


def main() -> None:
    """Train, and judge beside the EKF."""
    parser = argparse.ArgumentParser(description="A learned velocity estimator beside the EKF.")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--runs", type=int, default=200, help="count of runs it is judged on")
    parser.add_argument("--weights", type=Path, default=Path("learned_velocity.npz"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = export("cartpole", Path(folder) / "logs")  # the 200 runs of seed 0
        layers, factor = train(files, arguments.epochs)
    names = {f"a{i}": layer for i, layer in enumerate(layers)}
    np.savez(arguments.weights, factor=factor, **names)
    results = estbench.run(
        "cartpole", ["ekf", "learned"], seed=1, runs=arguments.runs,
        overrides=[
            f"estimators.learned.type={Path(__file__).stem}:LearnedVelocity",
            f'estimators.learned.weights="{arguments.weights.resolve()}"',
            "consistency.burn_in=0.2",  # s: until the window is full
        ],
    )  # fmt: skip
    print(results)
    for label, record in results.records.items():
        inside = [record[f"inside_{k}"].mean() for k in (1, 2, 3)]
        print(f"{label}: within 1, 2, 3 σ: {', '.join(f'{share:.1%}' for share in inside)}")
    print("a Gaussian: 68.3%, 95.4%, 99.7%")


if __name__ == "__main__":
    main()
