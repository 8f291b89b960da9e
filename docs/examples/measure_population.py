"""Measure a population: the SP/XP matrix as a pandas frame, and who plays how beside a random partner.

python docs/examples/measure_population.py runs/demo
"""

import sys

import popgen

population = popgen.load_population(sys.argv[1])
print(population)

matrix = popgen.evaluate_population(population, episodes=5)
print(matrix)
print(matrix.to_frame())

for member in range(1, len(population) + 1):
    episodes = population.play(member, "random", episodes=5)
    print(f"member {member} beside a random partner: {episodes}")
