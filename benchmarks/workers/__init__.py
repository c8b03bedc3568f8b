"""What runs in a process of its own: each module has `measure(...)`, which takes and returns what fits into JSON."""
