"""Progress and results in Weights & Biases or in MLflow; estbench depends on neither.

python examples/trackers.py wandb
python examples/trackers.py mlflow
"""

import sys

import estbench


def numbers(results):
    """The mean over the runs of each quantity, as `ekf/anees` or `ekf/rmse_hinge`."""
    means = results.to_dataframe().groupby("estimator").mean(numeric_only=True)
    found = {(label, name): x for label, row in means.iterrows() for name, x in row.items()}
    return {f"{label}/{name.replace(' ', '_')}": float(x) for (label, name), x in found.items()}


def with_wandb(scenario, **settings):
    """A run of Weights & Biases."""
    import wandb  # pyright: ignore[reportMissingImports]

    with wandb.init(project="estbench", config={"scenario": scenario, **settings}) as tracked:
        results = estbench.run(
            scenario, progress=lambda done, total: tracked.log({"runs": done}), **settings
        )
        tracked.log(numbers(results))
    return results


def with_mlflow(scenario, **settings):
    """A run of MLflow."""
    import mlflow  # pyright: ignore[reportMissingImports]

    with mlflow.start_run(run_name=scenario):
        mlflow.log_params({"scenario": scenario, **settings})
        results = estbench.run(
            scenario, progress=lambda done, total: mlflow.log_metric("runs", done), **settings
        )
        mlflow.log_metrics(numbers(results))
    return results


if __name__ == "__main__":
    print({"wandb": with_wandb, "mlflow": with_mlflow}[sys.argv[1]]("pendulum", runs=100))
