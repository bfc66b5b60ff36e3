"""GameFormer, DTPP and DIPP in Flax, on the data structures of the evaluator."""
