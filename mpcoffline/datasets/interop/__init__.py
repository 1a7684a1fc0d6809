"""Tables in the forms of other libraries."""
