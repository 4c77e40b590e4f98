"""The transports: parse, hand to the engine, serialise."""
