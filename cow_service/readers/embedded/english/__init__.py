"""The English of the embedded reader: what a question says, as records, by sentence forms and word lists."""
