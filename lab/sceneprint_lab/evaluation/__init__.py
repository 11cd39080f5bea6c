"""Evaluation on data sets with reference poses, with reproducible figures.

    PATH...  --choose-->  Protocol  --evaluate-->  Evaluation  --figures-->  JSON, table, pictures

Reference poses are used for the evaluation only.
"""
