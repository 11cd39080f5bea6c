"""The measure: a data set with known poses to figures anyone can repeat.

    PATH...  --choose-->  Protocol  --evaluate-->  Evaluation  --figures-->  JSON, table, pictures

Ground-truth poses are read here and nowhere else: they judge, they never help.
"""
