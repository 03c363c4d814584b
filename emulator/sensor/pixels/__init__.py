"""The pixel array: from light to threshold crossings with exact times."""
