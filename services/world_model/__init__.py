"""The world model: networks that predict images and touch, their training and serving."""
