"""Recording: what counts of a step, logs that survive a crash, data sets made of them."""
