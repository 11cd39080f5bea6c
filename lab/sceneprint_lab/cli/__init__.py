"""Commands that the lab adds to `sceneprint`."""

#: Summaries of the commands for `sceneprint --help`. Entry points specify the commands' modules.
COMMANDS = {
    "demo": "run a service, upload a map, query it over HTTP and print the accuracy",
    "evaluate": "measure retrieval, validation and pose accuracy on frames with known poses",
    "evaluate-pairs": "measure registration and acceptance on pairs of frames with known poses",
    "synth": "generate synthetic rooms with known poses",
    "train": "train a model",
}
