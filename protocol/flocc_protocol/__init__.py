"""What travels between robots: identifiers, key expressions, messages, log records, arrays, codec."""
