"""Low-level interface of Unitree's robots with DDS (Go2, B2), without the vendor's package."""
