"""The compiled core of retargeting: samples of tracked fingers in, joint angles out."""
