"""Command line, benchmarks and sweeps."""
