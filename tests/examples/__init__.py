"""What a user adds to jaxform from outside: each is one file and one registration."""
