"""Studies, their reports, and hyperparameter searches."""
