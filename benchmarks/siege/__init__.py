"""What strangers may send, and more than the service can do: it answers all, and loses nothing."""
