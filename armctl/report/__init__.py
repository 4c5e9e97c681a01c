"""Pages people look at: self-contained HTML, drawn with plotly.js."""
