"""The speed of csac, compared with its peers and with the limit of the machine: `python -m benchmarks --help`."""
