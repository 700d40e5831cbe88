"""How far an estimated path lies from the true one."""
