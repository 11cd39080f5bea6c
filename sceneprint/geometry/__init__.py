"""Pure geometry: arrays in, arrays out. A file for each section of the paper."""
