"""Tables, figures and report.html of one run folder. The paper's tables and figures are in paper/."""
