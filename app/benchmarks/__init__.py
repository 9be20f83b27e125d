"""What the running application is measured with."""
