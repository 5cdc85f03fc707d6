"""What is where: extinction, albedo and emission as functions of position."""
