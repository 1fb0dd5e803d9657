"""Third-party engines that are not files; their silent failures become exceptions here."""
