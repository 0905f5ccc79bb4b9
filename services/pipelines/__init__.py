"""What joins services: training data, imagined data, the demo, calibration of stations, studies."""
