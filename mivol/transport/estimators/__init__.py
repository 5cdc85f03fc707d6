"""How the integrals of transport are estimated: transmittance, distance, direct light, control variates, and their adjoints."""
