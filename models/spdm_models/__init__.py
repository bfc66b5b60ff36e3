"""Flax models on the evaluator's data structures."""
