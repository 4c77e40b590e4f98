"""Durable jobs: what one is (`record`), where they are kept (`store`), and their files (`folders`)."""
