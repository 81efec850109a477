"""What a person reads of a result: tables, pictures, pages."""
