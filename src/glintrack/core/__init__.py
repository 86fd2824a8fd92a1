"""The vocabulary: arrays, units, designs, schemas and records that every stage uses."""
