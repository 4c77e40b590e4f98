"""What clients and servers exchange beside whole files."""
