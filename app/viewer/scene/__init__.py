"""Drawing of hands, object, springs, forces, cameras and recorded points."""
