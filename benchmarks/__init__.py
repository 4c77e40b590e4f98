"""Commands that print this project's figures, each `python -m benchmarks.<name>`; what they said is in RESULTS.md.

command.py, conventional.py, reference.py and shapes.py are no commands: what these share, other filters, the published
scheme, and clouds with noise.
"""
