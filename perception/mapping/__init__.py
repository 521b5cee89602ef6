"""The map made from pictures: the first map, its growth, a scan's landmarks, relocalisation."""
