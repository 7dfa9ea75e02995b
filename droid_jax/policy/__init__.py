"""From the distribution to a policy: randomisation, PPO, evaluation, control, export."""
