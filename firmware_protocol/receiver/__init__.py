"""The ground side: decoders of what a camera sends, and the estimate of its clock."""
