"""Tables, pictures, pages and exports."""
