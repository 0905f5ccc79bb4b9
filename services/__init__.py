"""The verbs of DexTouch, in the order in which the data flows."""
