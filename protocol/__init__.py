"""The fieldbus contract: objects, EDS, buses, the device runtime and the tuner's client."""
