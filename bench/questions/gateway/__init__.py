"""Questions about one gateway (`multidrop serve`), its page and its interfaces."""
