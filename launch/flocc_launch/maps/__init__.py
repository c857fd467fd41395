"""Maps that outlive their missions: saved from stores, shown, merged, pruned, exported."""
