"""Where a run's records go: one sink each for the ledger, metrics, MLflow, gauges, run log and storage copy."""
