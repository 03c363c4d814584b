"""Sony and Prophesee's IMX636 as whoever writes its registers sees it, whatever carries the writes."""
