"""What measurements say of the joints and of the ground."""
