"""The map made from pictures: first map, matching of its patches in new pictures, growth, a scan's landmarks."""
