"""What must never happen while the bath is hot, who sees it, and who acts when the bench itself dies."""
