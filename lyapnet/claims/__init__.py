"""What is claimed of a controller: a claim as data, how it is established, and the certificate that says so."""
