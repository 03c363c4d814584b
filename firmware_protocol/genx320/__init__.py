"""Camera with Prophesee's GenX320 on USB."""
