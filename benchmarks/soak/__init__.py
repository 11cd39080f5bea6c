"""`make soak`, `fleet`, `siege`: robots on a service that is disturbed, and what was lost."""
