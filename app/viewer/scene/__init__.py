"""What is drawn: hands, object, springs, forces, cameras and recorded points."""
