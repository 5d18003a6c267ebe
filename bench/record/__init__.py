"""The run folder: schema, writer, reader, hash chain, check, export."""
