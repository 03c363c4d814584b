"""The ground side: decoders of a camera's output, and the estimate of its clock."""
