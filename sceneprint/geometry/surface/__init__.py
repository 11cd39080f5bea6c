"""Convert depth images and clouds to oriented surfaces."""
