"""The stage `store` of `dextouch bench`: a take in; time, bytes and errors of stores out."""
