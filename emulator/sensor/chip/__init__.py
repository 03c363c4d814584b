"""The chip around the pixels: imager effects, defects, leak, radiation, jitter and read-out."""
