"""The English of the embedded reader: what a question says, as records, by a grammar and word lists."""
