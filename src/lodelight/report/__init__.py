"""What a run leaves behind: the out folder and its report."""
