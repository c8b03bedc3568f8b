"""What is measured: each module has `PARTS`, and each of these a table."""
