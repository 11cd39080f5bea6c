"""The engine: computation on stored frames, from uploads to answers.

frame  --Uploads.add-->  store  --JobRunner.run-->  signature  --Queries.upload-->  Answer
"""
