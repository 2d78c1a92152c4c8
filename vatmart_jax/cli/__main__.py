from vatmart_jax.cli.main import main

main()
