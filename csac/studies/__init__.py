"""What is claimed: studies, their reports, and searches for hyperparameters."""
