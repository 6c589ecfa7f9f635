"""What is remembered and what is running: specs, store, queue and the tasks that workers run."""
