"""Flax models on the evaluator's data structures; none is ported yet."""
