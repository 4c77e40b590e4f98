"""Fast paths, each beside its plain torch twin in `straightpcf.model.ops`."""
