"""What a cloud is: in memory (`cloud`), on disk (`formats`), as a request (`options`, `errors`)."""
