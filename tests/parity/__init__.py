"""Parity harness: every stage against stored outputs of the reference implementations."""
