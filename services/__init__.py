"""Services of DexTouch, in the order of the data flow."""
