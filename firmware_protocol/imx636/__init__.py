"""Sony and Prophesee's IMX636: its registers and their effects, for any link."""
