"""Human players: reading recorded games, what people do in them, and clones of the players.

pickled_frame    columns of an old pickled table, read without unpickling
recordings       games of the installed overcooked-ai package as our states and actions
behaviour        event rates of people and of clones, and how well they agree
clone_inputs     what a clone's network sees
clone_policy     a clone as a policy
cloning          fitting a network to recorded games
proxies          choosing a clone by its play, and the population that holds it
humans_report    tables for the terminal
"""
