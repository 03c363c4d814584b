"""How right the pixels are: the truth, the rules of others, scores, and the charts of speed against accuracy."""
