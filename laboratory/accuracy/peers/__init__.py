"""Other simulators of event cameras on the closed-form scenes: sequences as files, adapters, worker, scores, page."""
