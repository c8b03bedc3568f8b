"""What is claimed: cells of training made into studies, on one machine or many, and their reports."""
