"""The one place that joins computation and storage: frames in, answers out.

frame  --Uploads.add-->  store  --JobRunner.run-->  signature  --Queries.upload-->  Answer
"""
