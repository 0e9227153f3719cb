"""The lab: closed loops as WebAssembly in one page, which runs them anew while a slider moves."""
