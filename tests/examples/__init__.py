"""Extensions of jaxform from outside: each is one file and one registration."""
