"""Commands that print this project's figures, each `python -m benchmarks.<name>`; what they said is in RESULTS.md."""
