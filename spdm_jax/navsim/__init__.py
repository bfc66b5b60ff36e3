"""NAVSIM's PDM score, v1 and v2: scenes, scores, and how to get them from NAVSIM itself."""
