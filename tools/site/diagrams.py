class Diagram:
    pass


def read_diagram(x):
    return Diagram()


def svg_of(a, b):
    return "<svg></svg>"
