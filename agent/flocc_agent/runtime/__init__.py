"""asyncio and zenoh live here only: driver, transports, workers, store, keyframe sources."""
