"""The engine: storage, signing and search of frames, from uploads to answers.

frame  --Uploads.add-->  store  --JobRunner.run-->  signature  --Queries.upload-->  Answer
"""
