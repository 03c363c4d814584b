"""Prophesee's event formats as bytes, both ways: EVT3 (drawn in `words`), EVT2 and EVT2.1 (in `evt2_words`)."""
