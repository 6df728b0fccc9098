"""How two fields are joined."""
