"""The client: a service over HTTP, or the engine in this process, with the same methods.

with Client("http://robot-server:8008") as client:  # or Client.embedded("maps")
    client.create_map("warehouse")
    client.upload("warehouse", path, wait_s=10)
    answer = client.query("warehouse", path)
"""

from sceneprint.client.backend import Status
from sceneprint.client.client import Client
from sceneprint.client.frames import meta_of

__all__ = ["Client", "Status", "meta_of"]
