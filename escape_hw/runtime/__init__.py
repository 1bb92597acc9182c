"""The system that scripts, procedures and the command line work on."""
