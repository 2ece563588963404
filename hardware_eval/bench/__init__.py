"""What happens at the bench: plan, safety, control loop, session, self-test and exploration."""
