"""What people and other programs write as text, read one way: characters, tables, documents."""
