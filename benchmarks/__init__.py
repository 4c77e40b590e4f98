"""Commands that print this project's figures: `quality`, `scans` and `speed`, each `python -m benchmarks.<name>`."""
